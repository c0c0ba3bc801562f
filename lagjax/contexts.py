"""Facts about the caller that programs depend on while they are traced, as contexts of JAX's.

JAX compiles a program for the values of all contexts there are: each new one makes it trace and compile again all that
it has compiled before, of the user's programs too. So all are made here, as lagjax is imported, and not where the room
is that uses them.
"""

import jax

# Whether a caller watches the course of motions, lane by lane.
WATCHED = jax.make_user_context(default_value=False)
# Whether failures are reported by their codes alone, in a program that cannot raise an error to anybody.
SILENT = jax.make_user_context(default_value=False)
# Whether the caller solves again with the robust method when equations assumed regular turn out singular.
REGULAR_FIRST = jax.make_user_context(default_value=False)
# In a batch, whose lanes wait for each other: the number of steps after which a motion is given up, to be run alone.
PATIENCE = jax.make_user_context(default_value=None)
# Where programs get names instead of being traced: the digest of what surrounds the whole program.
NAMING = jax.make_user_context(default_value=None)
# Whether what is traced will be differentiated, and forward only.
COLUMNS = jax.make_user_context(default_value=False)
