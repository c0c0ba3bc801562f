"""Whether a system can be stepped by a method of equal steps."""

from lagjax.mechanics import sees_velocities, structure, with_first_order
from lagjax.numerics import EqualSteps, Splitting
from lagjax.system import Model


def check_can_be_stepped(method: EqualSteps, model: Model):
    """Raise unless the method is made for systems like this one."""
    first = with_first_order(model).form.first_order
    if first is not None and isinstance(method, Splitting):
        names = ", ".join(f"'{name}'" for name, is_first in zip(model.names, first.mask(model.n)) if is_first)
        raise ValueError(
            f"lj.{method.label} steps coordinates with a mass, and {names} have none: they are of first order.\n"
            "Fix: method=lj.Gauss(3)."
        )
    if model.reacts:
        raise ValueError(f"lj.{method.label} does not solve for forces that take multipliers.\nFix: leave method out.")
    if isinstance(method, Splitting):
        _check_can_be_split(model)


def is_suited(method: EqualSteps, model: Model) -> bool:
    """Whether the method is made for systems like this one."""
    try:
        check_can_be_stepped(method, model)
    except ValueError:
        return False
    return True


def _check_can_be_split(model: Model):
    """Raise unless L = T(v) - V(q), forces do not depend on velocities, and constraints restrict positions."""
    found = structure(model)
    depends = "" if found is None else ", ".join(found.mass_depends_on)
    rolling = [f"'{residual.name}'" for residual in model.form.residuals if not residual.of_positions]
    if rolling or depends or sees_velocities(model):
        why = "they do"
        if rolling or depends:
            why = f"{', '.join(rolling)} restricts velocities" if rolling else f"the mass matrix depends on {depends}"
        raise ValueError(
            "lj.Splitting is for L = T(v) - V(q) with a constant mass matrix, forces that do not depend on velocities "
            f"and constraints on positions, and {why}.\n"
            "Usual cause: polar coordinates, joint angles, friction, a magnetic field, a rotating frame, rolling.\n"
            "Fix: method=lj.Gauss(3), which takes any L."
        )
