"""The closed table of what files may hold besides numbers, text, dicts, lists and tuples (`npz.py`).

A class or a function is looked up here by its package and its own name; a file's name that is not in the table is
refused, and nothing is imported for it. A file may give a class of ours the fields that it is defined with, and one of
another package those listed here. A class that is not listed, such as one of the user's, is passed as
`classes=[TheClass]`.
"""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from lagjax.numerics import tolerance_of_the_controller

# Our own classes by module: a file may give each the fields that it has where it is defined.
OURS = """
analysis.branches: Branches Branch Critical
analysis.energy: EnergyLedger
analysis.exponents: Floquet LyapunovExponents
analysis.linearise: Linearisation LinearisationKind LinearParts Raw
analysis.normal_modes: NormalModes Mode
analysis.poincare: PoincareSection
analysis.symmetry_test: SymmetryTest
bodies.body: Pose
fit.next_measurement: NextMeasurements Candidate
fit.records: Windows Record
fit.residuals: FitProblem
fit.result: Fit
fit.search: Misfit Evaluation
fit.uncertainty: Identifiability
fit.unknowns: Leaf FreeNumbers Chart Starts
integrate.events.event: Crossings
integrate.results: Errors Snapshot
integrate.trajectory: Switches
learned: Network SameMotion
numerics.newton: Unknowns Covariance
numerics.radau: Radau5 SimplifiedNewton
numerics.runge_kutta: Dopri8 Tsit5 RK4 Nystrom8 Nystrom12
numerics.symplectic: Gauss Splitting
sweep.engine: Status
system.coordinates: State
"""

# A module of another package, and the classes that are found there: their fields.
OTHERS = """
diffrax
  Euler SemiImplicitEuler LeapfrogMidpoint ReversibleHeun ConstantStepSize DirectAdjoint ForwardMode:
  Heun Midpoint Ralston Bosh3 Tsit5 Dopri5 Dopri8: scan_kind
  Kvaerno3 Kvaerno4 Kvaerno5 KenCarp3 KenCarp4 KenCarp5: scan_kind root_finder root_find_max_steps
  ImplicitEuler: root_finder root_find_max_steps
  HalfSolver: solver
  StepTo: ts
  PIDController: rtol atol norm pcoeff icoeff dcoeff dtmin dtmax force_dtmin factormin factormax safety error_order
  ClipStepSizeController: controller step_ts jump_ts store_rejected_steps callback_on_reject
  RecursiveCheckpointAdjoint: checkpoints
  VeryChord: rtol atol norm kappa linear_solver
optimistix
  Newton Chord: rtol atol norm kappa linear_solver cauchy_termination
lineax
  LU QR Cholesky Triangular Tridiagonal:
  AutoLinearSolver: well_posed
  Diagonal: well_posed rcond
  SVD: rcond
equinox.nn
  MLP: layers activation final_activation use_bias use_final_bias in_size out_size width_size depth scan
  Linear: weight bias in_features out_features use_bias
  Sequential: layers
  Lambda: fn
  Identity:
  PReLU: negative_slope
  Dropout: p inference
  Embedding: num_embeddings embedding_size weight
  LayerNorm RMSNorm: shape eps use_weight use_bias weight bias
  GroupNorm: groups channels eps channelwise_affine weight bias
  GRUCell: weight_ih weight_hh bias bias_n input_size hidden_size use_bias
  LSTMCell: weight_ih weight_hh bias input_size hidden_size use_bias
  Conv Conv1d Conv2d Conv3d: num_spatial_dims weight bias in_channels out_channels kernel_size stride padding dilation
    groups use_bias padding_mode
  ConvTranspose ConvTranspose1d ConvTranspose2d ConvTranspose3d: num_spatial_dims weight bias in_channels out_channels
    kernel_size stride padding output_padding dilation groups use_bias padding_mode
  AvgPool1d AvgPool2d AvgPool3d MaxPool1d MaxPool2d MaxPool3d: init operation num_spatial_dims kernel_size stride
    padding use_ceil
  MultiheadAttention: query_proj key_proj value_proj output_proj dropout num_heads query_size key_size value_size
    output_size qk_size vo_size use_query_bias use_key_bias use_value_bias use_output_bias
"""


def _listed() -> dict[str, tuple[str, tuple[str, ...] | None]]:
    """By package and name, the module of a class and its fields; None for those that it has itself."""
    found, module = {}, ""
    for line in OURS.split("\n")[1:-1]:
        module, _, names = line.partition(": ")
        found |= {f"lagjax.{name}": (f"lagjax.{module}", None) for name in names.split()}
    for line in re.sub(r"\n {4,}", " ", OTHERS).splitlines():
        names, _, fields = line.partition(":")
        if not line.startswith(" "):
            module = line
        for name in names.split() if line.startswith(" ") else ():
            found[f"{module.split('.')[0]}.{name}"] = module, tuple(fields.split())
    return found


LISTED = _listed()

# Functions: activations, norms and elementary ones.
_OF_NUMPY = """abs sign sqrt square exp expm1 log log1p sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh arctanh
    minimum maximum max mean"""
_OF_NN = """celu elu gelu glu hard_sigmoid hard_silu hard_swish hard_tanh leaky_relu log_sigmoid log_softmax mish relu
    relu6 selu sigmoid silu soft_sign softmax softplus squareplus swish"""
FUNCTIONS: dict[str, Callable] = {
    **{f"jax.numpy.{name}": getattr(jnp, name) for name in _OF_NUMPY.split()},
    **{f"jax.nn.{name}": getattr(jax.nn, name) for name in _OF_NN.split() if hasattr(jax.nn, name)},
    **{f"jax.lax.{name}": getattr(jax.lax, name) for name in ("tanh", "sin", "cos", "exp", "logistic", "max", "add")},
    **{f"optimistix.{name}": getattr(optx, name) for name in ("rms_norm", "max_norm", "two_norm")},
    # What an MLP applies last, unless it is told otherwise.
    "equinox.nn._identity": inspect.signature(eqx.nn.MLP.__init__).parameters["final_activation"].default,
}
_BY_PACKAGE = {f"{name.split('.')[0]}.{name.rsplit('.', 1)[1]}": x for name, x in reversed(FUNCTIONS.items())}

# Classes by the names that they had when files of 0.2 were first written.
RENAMED = {"Found": "FreeNumbers", "Problem": "FitProblem", "Kind": "LinearisationKind", "Parts": "LinearParts"}

# Says that a solver takes its tolerances, and the norm that they are measured in, from the controller.
FROM_CONTROLLER = type(tolerance_of_the_controller())
# What stands for a number, while a motion is computed in lanes as well.
NUMBERS = (bool, int, float, complex, np.number, np.bool_, np.ndarray, jax.Array, FROM_CONTROLLER)


class UnknownClass(ValueError):
    """A file holds an object of a class that is not in the table and was not passed."""


class Table:
    """The classes and functions that a file may name: those listed here, and `classes` of the user's."""

    def __init__(self, classes: Iterable[type] = ()):
        self._given: dict[str, list[type]] = {}
        for cls in classes:
            if not isinstance(cls, type) or fields_of(cls) is None:
                raise TypeError(
                    f"classes holds {cls!r:.80}, which is not the class of a named tuple or a dataclass.\n"
                    "Fix: classes=[TheClass], with the classes themselves."
                )
            # By its full name, or by its own: the module that wrote a file may have had another name, such as __main__.
            for name in (f"{cls.__module__}.{cls.__qualname__}", cls.__qualname__):
                self._given.setdefault(name, []).append(cls)

    def class_of(self, module: str, name: str) -> tuple[type, tuple[str, ...], bool]:
        """The class that a file names, the fields that it may have, and whether it is listed here.

        **Raises:** `UnknownClass`, a `ValueError`.
        """
        found = listed(module, name)
        given = self._given.get(f"{module}.{name}") or ([] if found else self._given.get(name, []))
        if given and all(cls is given[0] for cls in given):
            return given[0], fields_of(given[0]) or (), False
        if found is None:
            raise UnknownClass(
                f"it holds an object of class {f'{module}.{name}'[:200]}, which is neither lagjax's nor passed.\n"
                f"Usual cause: a class of your own.\nFix: classes=[{name.rsplit('.', 1)[-1][:100]}]."
            )
        return *found, True

    @staticmethod
    def function_of(module: str, name: str) -> Callable:
        """The function that a file names.

        **Raises:** `ValueError` if it is not in the table.
        """
        found = FUNCTIONS.get(f"{module}.{name}") or _BY_PACKAGE.get(f"{module.split('.')[0]}.{name}")
        if found is None:
            raise ValueError(
                f"it names the function {module}.{name}"[:200] + ", and functions are not read from files.\n"
                "Usual cause: a file that lagjax has not written."
            )
        return found


def listed(module: str, name: str) -> tuple[type, tuple[str, ...]] | None:
    """A class of the table and the fields that it may have; None if it is not listed."""
    name = RENAMED.get(name, name) if module.split(".")[0] == "lagjax" else name
    place, fields = LISTED.get(f"{module.split('.')[0]}.{name}", (None, ()))
    if place is None:
        return None
    cls = getattr(import_module(place), name)
    return cls, (fields_of(cls) or ()) if fields is None else fields


def name_of_function(value: Any) -> dict[str, str] | None:
    """How a file names a function of the table; None for any other."""
    for name, function in FUNCTIONS.items():
        if function is value:
            module, _, own = name.rpartition(".")
            return {"module": module, "name": own}
    return None


def fields_of(cls: type) -> tuple[str, ...] | None:
    """The names of the fields of a named tuple or a dataclass; None for other classes."""
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        return tuple(getattr(cls, "_fields"))
    return tuple(field.name for field in dataclasses.fields(cls)) if dataclasses.is_dataclass(cls) else None


def check_field(cls: type, name: str, value: Any) -> None:
    """Raise `ValueError` if a value is not of the kind that a field is annotated with, or a static one has no hash."""
    annotation = annotations_of(cls).get(name, Any)
    fitting = fits(value, annotation)
    static = dataclasses.is_dataclass(cls) and any(
        field.name == name and field.metadata.get("static") for field in dataclasses.fields(cls)
    )
    if fitting and static:
        try:
            hash(value)
        except TypeError:
            fitting = False
    if not fitting:
        raise ValueError(f"the field {name} of {cls.__name__} cannot be {value!r:.60}.")


def annotations_of(cls: type) -> dict[str, Any]:
    """The annotations of the fields of a class."""
    if dataclasses.is_dataclass(cls):
        return {field.name: field.type for field in dataclasses.fields(cls)}
    return getattr(cls, "__annotations__", {})


def fits(value: Any, annotation: Any) -> bool:
    """Whether a value is of the annotated kind: numbers, text, functions, containers or an object. Shapes are free."""
    if isinstance(annotation, str) or annotation in (Any, None):
        return value is None if annotation is None else True
    origin, inside = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in inside)
    if origin is typing.Literal:
        return value in inside
    if origin is tuple and isinstance(value, tuple) and inside:
        kinds = inside[:1] * len(value) if inside[-1] is Ellipsis else inside
        return len(kinds) == len(value) and all(map(fits, value, kinds))
    if origin is dict and isinstance(value, dict):
        return all(fits(key, inside[0]) and fits(x, inside[1]) for key, x in value.items())
    kind = origin or annotation
    if kind in (int, float, bool, complex) or hasattr(kind, "dtypes") or kind in (jax.Array, np.ndarray):
        return isinstance(value, NUMBERS)
    if kind is Callable or kind is typing.Callable:
        return callable(value) or isinstance(value, FROM_CONTROLLER)
    is_class = isinstance(kind, type) and kind.__module__ != "jaxtyping"
    return isinstance(value, kind) if is_class else True
