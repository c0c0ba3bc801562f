"""What lagjax does with JAX's programs, whatever they compute: jaxprs as data, compiling, caches."""

from lagjax.jaxtools import folder
from lagjax.jaxtools.cache import (
    FACTS,
    HashablePart,
    compiler_options,
    filled_up,
    hashable_partition,
    is_array,
    kinds,
    once,
    program_of,
    remembered,
    same,
    shape_of,
    varies,
)
from lagjax.jaxtools.columns import FEW, Columns, Lanes, axes_of, changes_from, from_python, have_columns
from lagjax.jaxtools.compiled import compiled
from lagjax.jaxtools.dependence import is_linear, pattern
from lagjax.jaxtools.fuse import (
    PRODUCT,
    TOGETHER,
    apart,
    calls_host,
    kept_as_call,
    one_function,
    one_function_in_both_modes,
    poisoned,
)
from lagjax.jaxtools.jaxpr import (
    ADDITIVE,
    ARITHMETIC,
    BILINEAR,
    LINEAR_IN_FIRST,
    MOVING,
    PERIODIC,
    ClosedJaxpr,
    Itself,
    Jaxpr,
    Literal,
    Meaning,
    anywhere,
    applied,
    bodies,
    callbacks_in_turn,
    content_of,
    depends,
    equations,
    evaluate,
    interpreted,
    length,
    meaning_of,
    needed,
    once_per_program,
    outputs_of,
    rule_follows,
    rules_of,
    run,
    staged,
    stands_for,
    with_own_constants,
    without_repeats,
    written,
)
from lagjax.jaxtools.kept import LATER, TALLY, KeptProgram, NotKept, Said, Unusable
from lagjax.jaxtools.many_steps import steps_in_both_modes
from lagjax.jaxtools.names import named, surroundings_for_names
from lagjax.jaxtools.open_jumps import (
    COMPARISONS,
    IN_TIME,
    JumpOpening,
    JumpTable,
    KnownValue,
    Slot,
    Timed,
    has_jumps,
    judging,
)
from lagjax.jaxtools.outline import NoOutline, outlined, rebuilt
from lagjax.jaxtools.primitives import (
    ad,
    filled,
    front,
    is_float,
    jaxpr_as_fun,
    jitted,
    linear_map_primitive,
    no_tangent,
    one_by_one,
    primitive,
    split,
)
from lagjax.jaxtools.scalarize import LARGE, TooLong, written_out
from lagjax.jaxtools.tracing import (
    HAPPENED,
    as_usual,
    at_once,
    decided,
    full_products,
    is_differentiated,
    is_eager,
    is_plain,
    is_traced,
    like,
    numpy_of,
    stop_gradient,
    takes_for_regular,
    to_jax,
    where,
    without_init,
)
