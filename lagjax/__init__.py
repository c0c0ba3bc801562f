"""lagjax: a differentiable Lagrangian integrator.

Write a Lagrangian as a plain JAX function `L(t, q, v, params)`; everything else follows from it. `__init__.pyi` lists
the names in the order of the physics; each is imported on first access. Worked systems are in `lagjax.scenes`.

    M a = F + Aᵀ λ      M = ∂²L/∂v∂v,   F = ∂L/∂q - ∂p/∂t - (∂p/∂q) v + Q - ∂R/∂v,   p = ∂L/∂v
    A a = gamma         A = ∂g/∂q (holonomic g = 0) or ∂phi/∂v (velocity constraint phi = 0)

λ > 0 pushes along +∂g/∂q; `R = ½ c v²` gives the force `-c v`; `jacobi_integral` is `v·p - L`, which is
T + V only for natural, time-independent coordinates.
"""

import lazy_loader

__version__ = "0.2.0"

# Scientific Python's SPEC 1. `EAGER_IMPORT=1` in the environment imports all at once.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
