"""Equations of the test problems as printed in their sources, and our own reduced equations, in NumPy and SciPy.

Nothing here uses lagjax: these are the references for lagjax.
"""

import mpmath
import numpy as np
from scipy.integrate import solve_ivp


def andrews(q, v, p):
    """(M, f, g, G) of Hairer & Wanner §VII.7 as in the Bari test set: M a = f - Gᵀ λ. Complex q, v allowed."""
    m1, m2, m3, m4, m5, m6, m7 = p["m"]
    i1, i2, i3, i4, i5, i6, i7 = p["I"]
    d, da, e, ea, rr, ra, ss = (p[k] for k in ("d", "da", "e", "ea", "rr", "ra", "ss"))
    sa, sb, sc, sd, zt, zf, fa, u = (p[k] for k in ("sa", "sb", "sc", "sd", "zt", "zf", "fa", "u"))
    ta, tb, ua, ub = (p[k] for k in ("ta", "tb", "ua", "ub"))
    be, th, ga, ph, de, om, ep = q
    bep, thp, _, php, dep, omp, epp = v
    M = np.zeros((7, 7), q.dtype)
    M[0, 0] = m1 * ra**2 + m2 * (rr**2 - 2 * da * rr * np.cos(th) + da**2) + i1 + i2
    M[0, 1] = M[1, 0] = m2 * (da**2 - da * rr * np.cos(th)) + i2
    M[1, 1] = m2 * da**2 + i2
    M[2, 2] = m3 * (sa**2 + sb**2) + i3
    M[3, 3] = m4 * (e - ea) ** 2 + i4
    M[3, 4] = M[4, 3] = m4 * ((e - ea) ** 2 + zt * (e - ea) * np.sin(ph)) + i4
    M[4, 4] = m4 * (zt**2 + 2 * zt * (e - ea) * np.sin(ph) + (e - ea) ** 2) + m5 * (ta**2 + tb**2) + i4 + i5
    M[5, 5] = m6 * (zf - fa) ** 2 + i6
    M[5, 6] = M[6, 5] = m6 * ((zf - fa) ** 2 - u * (zf - fa) * np.sin(om)) + i6
    M[6, 6] = m6 * ((zf - fa) ** 2 - 2 * u * (zf - fa) * np.sin(om) + u**2) + m7 * (ua**2 + ub**2) + i6 + i7
    xd, yd = sd * np.cos(ga) + sc * np.sin(ga) + p["xb"], sd * np.sin(ga) - sc * np.cos(ga) + p["yb"]
    lang = np.sqrt((xd - p["xc"]) ** 2 + (yd - p["yc"]) ** 2)
    force = -p["c0"] * (lang - p["l0"]) / lang
    fx, fy = force * (xd - p["xc"]), force * (yd - p["yc"])
    f = np.array(
        [
            p["mom"] - m2 * da * rr * thp * (thp + 2 * bep) * np.sin(th),
            m2 * da * rr * bep**2 * np.sin(th),
            fx * (sc * np.cos(ga) - sd * np.sin(ga)) + fy * (sd * np.cos(ga) + sc * np.sin(ga)),
            m4 * zt * (e - ea) * dep**2 * np.cos(ph),
            -m4 * zt * (e - ea) * php * (php + 2 * dep) * np.cos(ph),
            -m6 * u * (zf - fa) * epp**2 * np.cos(om),
            m6 * u * (zf - fa) * omp * (omp + 2 * epp) * np.cos(om),
        ]
    )
    x, y = rr * np.cos(be) - d * np.cos(be + th), rr * np.sin(be) - d * np.sin(be + th)
    g = np.array(
        [
            x - ss * np.sin(ga) - p["xb"],
            y + ss * np.cos(ga) - p["yb"],
            x - e * np.sin(ph + de) - zt * np.cos(de) - p["xa"],
            y + e * np.cos(ph + de) - zt * np.sin(de) - p["ya"],
            x - zf * np.cos(om + ep) - u * np.sin(ep) - p["xa"],
            y - zf * np.sin(om + ep) + u * np.cos(ep) - p["ya"],
        ]
    )
    G = np.zeros((6, 7), q.dtype)
    G[0::2, 0], G[1::2, 0] = -rr * np.sin(be) + d * np.sin(be + th), rr * np.cos(be) - d * np.cos(be + th)
    G[0::2, 1], G[1::2, 1] = d * np.sin(be + th), -d * np.cos(be + th)
    G[0, 2], G[1, 2] = -ss * np.cos(ga), -ss * np.sin(ga)
    G[2, 3], G[3, 3] = -e * np.cos(ph + de), -e * np.sin(ph + de)
    G[2, 4], G[3, 4] = -e * np.cos(ph + de) + zt * np.sin(de), -e * np.sin(ph + de) - zt * np.cos(de)
    G[4, 5], G[5, 5] = zf * np.sin(om + ep), -zf * np.cos(om + ep)
    G[4, 6], G[5, 6] = zf * np.sin(om + ep) - u * np.cos(ep), -zf * np.cos(om + ep) - u * np.sin(ep)
    return M, f, g, G


def andrews_end(q0, v0, end, p, rtol=1e-13):
    """(q, v) at `end` by DOP853 on the printed equations, with the constraint at acceleration level."""

    def field(t, y):
        q, v = y[:7], y[7:]
        M, f, _, G = andrews(q, v, p)
        # (d/dt G) v by a complex step: exact to round-off.
        gamma = -(andrews(q + 1e-30j * v, v + 0j, p)[3].imag / 1e-30) @ v
        matrix = np.block([[M, G.T], [G, np.zeros((6, 6))]])
        return np.concatenate([v, np.linalg.solve(matrix, np.concatenate([f, gamma]))[:7]])

    y = solve_ivp(field, (0, end), np.concatenate([q0, v0]), "DOP853", rtol=rtol, atol=rtol).y[:, -1]
    return y[:7], y[7:]


def car_axis(t, q, p):
    """(mass, f, g, G) of the Bari test set: k a = f + Gᵀ λ. G's rows are the factors of its λ1 and λ2."""
    xl, yl, xr, yr = q
    yb = p["r"] * np.sin(p["omega"] * t)
    xb = np.sqrt(p["L"] ** 2 - yb**2)
    k = p["M"] * p["epsilon"] ** 2 / 2
    Ll, Lr = np.sqrt(xl**2 + yl**2), np.sqrt((xr - xb) ** 2 + (yr - yb) ** 2)
    f = np.array(
        [
            (p["L0"] - Ll) * xl / Ll,
            (p["L0"] - Ll) * yl / Ll - k * p["g"],
            (p["L0"] - Lr) * (xr - xb) / Lr,
            (p["L0"] - Lr) * (yr - yb) / Lr - k * p["g"],
        ]
    )
    g = np.array([xb * xl + yb * yl, (xl - xr) ** 2 + (yl - yr) ** 2 - p["L"] ** 2])
    G = np.array([[xb, yb, 0, 0], [2 * (xl - xr), 2 * (yl - yr), -2 * (xl - xr), -2 * (yl - yr)]])
    return k, f, g, G


def ladder_end(windows, end, p, speed=1.0):
    """(q, v) of the heads at `end` in Jacobi's elliptic functions, for a ladder that goes over the top.

    ψ = angle from below obeys ψ̈ = -k sin ψ, ψ(0) = π, so sin(ψ/2) = sn(n t + K, m) with n² = (h + k)/2,
    m = 2k/(h + k), h = ½ ψ̇² - k cos ψ > k.
    """
    with mpmath.workdps(40):
        l, N = mpmath.mpf(p["l"]), windows
        k = (N + mpmath.mpf(N + 1) / 2) * mpmath.mpf(p["g"]) / ((N + mpmath.mpf(N + 1) / 3) * l)
        h = (speed / l) ** 2 / 2 + k
        n, m = mpmath.sqrt((h + k) / 2), 2 * k / (h + k)
        at = n * mpmath.mpf(end) + mpmath.ellipk(m)
        sn, cn, dn = (mpmath.ellipfun(kind, at, m=m) for kind in ("sn", "cn", "dn"))
        x, y, rate = -2 * sn * cn * l, (2 * sn**2 - 1) * l, 2 * n * dn
        q = np.stack([np.arange(N + 1) * float(l) + float(x), np.full(N + 1, float(y))], axis=1)
        return q, np.tile([float(rate * y), float(-rate * x)], (N + 1, 1))


def governor_field(p):
    """The right-hand side of (ψ, α, z, dα/dt, dz/dt) with ∂L/∂ψ̇ constant."""
    m, M, ms, I = p["rod"], p["ball"], p["slider"], p["I"]
    l, b, h, k, c, l0, g = (p[x] for x in ("l", "b", "h", "k", "c", "l0", "g"))
    J, moment = 2 * (m / 3 + M) * l**2, (m / 2 + M) * l

    def spin(angle):
        """Inertia about the shaft, and its derivative."""
        sin, cos = np.sin(angle), np.cos(angle)
        inertia = I + 2 * (m * (b**2 + b * l * cos + (l * cos) ** 2 / 3) + M * (b + l * cos) ** 2)
        return inertia, -2 * l * sin * (m * (b + 2 * l * cos / 3) + 2 * M * (b + l * cos))

    momentum = spin(np.pi / 6)[0] * 2 * np.pi

    def field(t, y):
        _, angle, z, rate, slide = y
        inertia, slope = spin(angle)
        turn = momentum / inertia
        x, y = 0.5 * l * np.cos(angle), h - 0.5 * l * np.sin(angle) - z
        s = np.hypot(x, y)
        by_angle, by_z = -0.5 * l * (x * np.sin(angle) + y * np.cos(angle)) / s, -y / s
        force = k * (s - l0) + c * (by_angle * rate + by_z * slide)
        acceleration = (0.5 * slope * turn**2 + 2 * g * moment * np.cos(angle) - 2 * force * by_angle) / J
        return [turn, rate, slide, acceleration, -g - 2 * force * by_z / ms]

    return field


def governor_state(p, field, y):
    """(q, v) in the order (ψ, z, C, D) of the five numbers that `governor_field` integrates."""
    psi, angle, z, rate, slide = y
    l, b, h, turn = p["l"], p["b"], p["h"], field(0.0, y)[0]
    reach = b + l * np.cos(angle)
    e, n, up = np.array([np.cos(psi), np.sin(psi), 0]), np.array([-np.sin(psi), np.cos(psi), 0]), np.array([0, 0, 1])
    height, outwards = (h - l * np.sin(angle)) * up, -l * np.sin(angle) * rate * e + reach * turn * n
    sinking = -l * np.cos(angle) * rate * up
    q = np.concatenate([[psi, z], reach * e + height, -reach * e + height])
    return q, np.concatenate([[turn, slide], outwards + sinking, -outwards + sinking])
