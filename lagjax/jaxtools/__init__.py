"""What lagjax does with JAX's programs, whatever they compute: jaxprs as data, compiling, caches."""

from lagjax.jaxtools.cache import (
    FACTS,
    HashablePart,
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
from lagjax.jaxtools.compiled import compiled, compiler_options
from lagjax.jaxtools.fuse_both_modes import one_function_in_both_modes
from lagjax.jaxtools.fuse_cpu import PRODUCT, TOGETHER, apart, calls_host, kept_as_call, one_function, poisoned
from lagjax.jaxtools.jaxpr import (
    ADDITIVE,
    ARITHMETIC,
    BILINEAR,
    LINEAR_IN_FIRST,
    MOVING,
    PERIODIC,
    ClosedJaxpr,
    Jaxpr,
    Literal,
    anywhere,
    applied,
    bodies,
    callbacks_in_turn,
    depends,
    equations,
    evaluate,
    interpreted,
    length,
    needed,
    once_per_program,
    outputs_of,
    run,
    staged,
    stands_for,
    written,
)
from lagjax.jaxtools.jaxpr_identity import (
    Itself,
    Meaning,
    content_of,
    meaning_of,
    rule_follows,
    rules_of,
    with_own_constants,
    without_repeats,
)
from lagjax.jaxtools.linearity import is_linear
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
from lagjax.jaxtools.plain import is_plain
from lagjax.jaxtools.primitives import (
    ad,
    front,
    is_float,
    jaxpr_as_fun,
    linear_map_primitive,
    no_tangent,
    primitive,
    split,
)
from lagjax.jaxtools.scalarize import LARGE, TooLong, written_out
from lagjax.jaxtools.sparsity import pattern
from lagjax.jaxtools.tracing import (
    REGULAR_FIRST,
    SILENT,
    WATCHED,
    as_usual,
    at_once,
    full_products,
    is_differentiated,
    is_eager,
    is_traced,
    numpy_of,
    takes_for_regular,
    to_jax,
)
from lagjax.jaxtools.trees import decided, like, stop_gradient, where, without_init
from lagjax.jaxtools.without_lapack_batches import jitted, one_by_one
