"""Laplace's approximation: exact for a normal posterior, the true Hessian elsewhere, caveats without a peak."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import lagjax as lj
from tests.counting import compiles
from tests.fit.cases import PENDULUM, pendulum

T, SIGMA = np.linspace(0.0, 2.0, 21), 0.1
fall = lj.System(lambda t, q, v, p: 0.5 * v**2 + p["g"] * q)
swing = lj.System(lambda t, q, v, p: 0.5 * v**2 + p["w2"] * jnp.cos(q))
FAR = np.linspace(0.0, 6.0, 15)


def measured(seed=0):
    """Measurements of a fall, with errors."""
    return 1.0 + 0.5 * T + 4.9 * T**2 + SIGMA * np.random.default_rng(seed).normal(size=21)


def exact(y, prior):
    """Mean, covariance and log evidence of g, q0 and v0 in q = q0 + v0 t + g t²/2, where g has a normal prior."""
    rows = np.stack([T**2 / 2, np.ones(21), T], axis=1) / SIGMA
    rows, y = np.vstack([rows, [1 / prior[1], 0.0, 0.0]]), np.append(y / SIGMA, prior[0] / prior[1])
    inverse = np.linalg.inv(rows.T @ rows)
    mean = inverse @ rows.T @ y
    evidence = -0.5 * np.sum((y - rows @ mean) ** 2) - 21 * np.log(SIGMA) - np.log(prior[1]) - 11 * np.log(2 * np.pi)
    return mean, inverse, evidence + 1.5 * np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(inverse)[1]


@pytest.mark.exhaustive
def test_a_linear_motion_has_this_posterior():
    """Mean, covariance and evidence of a fall with a prior; there are no caveats, and nothing is compiled twice."""
    y = measured()
    fit = lambda prior, y=y: lj.fit(fall, lj.Record(T, q=y, sigma=SIGMA), {"g": 9.0}, priors={"g": prior})
    found = fit((9.81, 0.1))
    told = found.laplace()
    mean, covariance, evidence = exact(y, (9.81, 0.1))
    assert told.names == ("g", "q(0)", "v.q(0)") and told.positive_definite and told.caveats == ()
    np.testing.assert_allclose(told.mean, mean, rtol=1e-7)
    np.testing.assert_allclose(told.covariance, covariance, rtol=1e-6)
    np.testing.assert_allclose(told.gauss_newton, covariance, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, covariance[:1, :1], rtol=1e-6)
    np.testing.assert_allclose(told.eigenvalues, 1.0, atol=1e-9)
    assert told.log_evidence == pytest.approx(evidence, abs=1e-6)
    assert f"log evidence {evidence:.6g}" in repr(told)
    with compiles() as programs:
        other = fit((9.9, 0.02)).laplace()
    assert programs == []
    # Twin: another prior has another evidence.
    assert other.log_evidence == pytest.approx(exact(y, (9.9, 0.02))[2], abs=1e-6)
    assert abs(other.log_evidence - evidence) > 0.3


@pytest.mark.exhaustive
def test_draws():
    """Draws have the covariance of the fall, and the standardised density is a standard normal one."""
    y = measured()
    found = lj.fit(fall, lj.Record(T, q=y, sigma=SIGMA), {"g": 9.0}, priors={"g": (9.81, 0.1)})
    told, (mean, covariance, _) = found.laplace(), exact(y, (9.81, 0.1))
    draws = told.sample(jax.random.key(0), 4000)
    assert draws["g"].shape == (4000,) and draws["starts"].shape == (4000, 1, 2)
    rows = np.concatenate([np.asarray(draws["g"])[:, None], np.asarray(draws["starts"])[:, 0]], axis=1)
    np.testing.assert_allclose(rows[:, 0].mean(), mean[0], atol=4 * np.sqrt(covariance[0, 0] / 4000))
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(np.cov(rows.T) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.1)
    z = jax.random.normal(jax.random.key(1), (5, 3))
    of = jax.vmap(told.standardised(found.log_posterior))(z) - told.standardised(found.log_posterior)(jnp.zeros(3))
    np.testing.assert_allclose(of, -0.5 * np.sum(np.asarray(z) ** 2, axis=1), rtol=1e-6)
    # Twin: the likelihood alone is not.
    of = jax.vmap(told.standardised(found.log_likelihood))(z) - told.standardised(found.log_likelihood)(jnp.zeros(3))
    assert not np.allclose(of, -0.5 * np.sum(np.asarray(z) ** 2, axis=1), rtol=0.05)
    density, point = found.log_posterior, {"g": 9.7, "starts": told.unknowns(jnp.ones(3))["starts"]}
    prior = -0.5 * ((9.7 - 9.81) / 0.1) ** 2
    assert float(density(point) - found.log_likelihood(point)) == pytest.approx(prior, rel=1e-9)


@pytest.fixture(scope="module")
def rough():
    """A large swing, measured so badly that its residuals are large."""
    clean = np.asarray(lj.integrate(swing, 2.0, 0.0, {"w2": 4.0}, ts=FAR).q)
    data = clean + 0.6 * np.random.default_rng(0).normal(size=15)
    return data, lj.fit(swing, lj.Record(FAR, q=data, q0=2.0, v0=0.0, sigma=0.6), {"w2": 4.2})


def compared(found):
    """Laplace's approximation, whose covariance is that of JAX's Hessian of the likelihood; and that Hessian."""
    told, (flat, back) = found.laplace(), ravel_pytree(found.sampling)
    # Starts come first there.
    order = np.roll(np.arange(len(flat)), len(found.names))
    order = np.ix_(order, order)
    hessian = np.asarray(jax.jit(jax.hessian(lambda x: -found.log_likelihood(back(x))))(flat))[order]
    inverse = np.linalg.inv(hessian)
    sizes = np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
    np.testing.assert_allclose(told.covariance / sizes, inverse / sizes, atol=1e-5)
    return told, hessian


@pytest.mark.exhaustive
def test_large_residuals(rough):
    """The Hessian has the term S of the residuals' curvature. Twin: the Gauss-Newton one has not."""
    _, found = rough
    told, hessian = compared(found)
    gauss_newton = np.linalg.inv(told.gauss_newton)
    assert not np.allclose(gauss_newton, hessian, rtol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(told.gauss_newton))[:1], found.sd, rtol=1e-6)
    standard = jax.hessian(told.standardised(found.log_likelihood))(jnp.zeros(3))
    np.testing.assert_allclose(standard, -np.eye(3), atol=1e-6)


@pytest.mark.exhaustive
def test_no_peak(rough):
    """A direction without a peak is named, and nothing is drawn; an estimate off the peak gets a caveat."""
    data, found = rough
    moved = lambda x: eqx.tree_at(lambda f: f.unknowns.shared, found, np.array([x]))
    with pytest.warns(lj.FitWarning, match="no peak, but a saddle or plateau: the density does not fall along .*'w2'"):
        told = moved(2.5).laplace()
    assert told.eigenvalues[0] < 0 and not told.positive_definite and np.isnan(told.log_evidence)
    assert np.isnan(told.sd[0]) and "no peak" in repr(told)
    for draw in (lambda: told.sample(jax.random.key(0), 3), lambda: told.standardised(found.log_likelihood)):
        with pytest.raises(ValueError, match="(?s)no normal distribution here: no peak.*priors="):
            draw()
    aside = moved(found.values[0] + 0.2 * found.sd[0]).laplace()
    assert aside.positive_definite and aside.off > 0.1 and "the estimate is not the peak" in aside.caveats[0]
    # Twin: there is no such caveat at the peak.
    assert found.laplace().off < 1e-3 and all("peak" not in words for words in found.laplace().caveats)

    with pytest.warns(lj.FitWarning):
        unseen = lj.fit(pendulum, lj.Record(T, q=np.cos(T), sigma=0.3), PENDULUM, free=["c", "g", "l"], restarts=0)
    with pytest.warns(lj.FitWarning, match="the data do not determine .*'g'.*'l'"):
        told = unseen.laplace()
    assert np.isnan(told.sd[:3]).all() and np.isfinite(told.sd[3:]).all() and len(told.unseen) == 1
    with pytest.raises(TypeError, match="outside of the program"):
        jax.jit(lambda x: lj.fit(fall, lj.Record(T, q=x), {"g": 9.0}, restarts=0).laplace().mean)(measured())


@pytest.mark.exhaustive
def test_windows_records_and_a_loss_that_forgives():
    """With independent windows or a robust loss it agrees with JAX's Hessian; joined windows are refused."""
    data = np.asarray(lj.integrate(swing, 2.0, 0.0, {"w2": 4.0}, ts=FAR).q)
    data = data + 0.1 * np.random.default_rng(0).normal(size=15)
    apart = lj.fit(swing, lj.Record(FAR, q=data, sigma=0.1), {"w2": 4.0}, window=2.0, joined=False, restarts=0)
    told, _ = compared(apart)
    assert len(told.names) == 7 and told.names[1] == "q(0) of window 0"
    joined = lj.fit(swing, lj.Record(FAR, q=data, sigma=0.1), {"w2": 4.0}, window=2.0, restarts=0)
    with pytest.raises(ValueError, match="windows of this fit are joined"):
        joined.laplace()
    runs = [lj.Record(FAR, q=data, sigma=0.1), lj.Record(FAR[:8], q=data[:8], q0=2.0, v0=0.0, hold_v=True, sigma=0.1)]
    found = lj.fit(swing, runs, {"w2": 4.0}, restarts=0)
    told = found.laplace()
    assert told.names == ("w2", "q(0) of record 0", "v.q(0) of record 0", "q(0) of record 1")
    np.testing.assert_allclose(np.diag(told.gauss_newton)[0], found.sd[0] ** 2, rtol=1e-6)
    assert told.unknowns(jnp.zeros((2, 4)))["starts"].shape == (2, 2, 2)
    data[4] += 2.0
    wild = lj.Record(FAR, q=data, q0=2.0, v0=0.0, sigma=0.1)
    forgiving = lj.fit(swing, wild, {"w2": 4.0}, loss="cauchy", restarts=0)
    told, _ = compared(forgiving)
    assert np.isnan(told.log_evidence) and abs(forgiving.values[0] - 4.0) < 0.3
    assert np.isnan(lj.fit(swing, lj.Record(FAR, q=data, q0=2.0, v0=0.0), {"w2": 4.0}).laplace().log_evidence)
