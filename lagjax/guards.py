"""Guards of `lj.Switch` for contacts between two phases: one touches, releases, slips or sticks.

>>> import lagjax as lj
>>> lj.Switch("rolls", to="flies", when=lj.guards.releases("contact"))
Switch('rolls' -> 'flies', with a reset)

Any function of (t, q, v, params) can be a guard; these know of multipliers, and bring the impact with them.
"""

from lagjax.integrate import releases, slips, sticks, touches

__all__ = ["releases", "slips", "sticks", "touches"]
