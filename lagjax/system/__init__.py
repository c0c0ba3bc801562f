"""What the user writes, how it is checked, and the prepared model of it."""

from lagjax.system import constraints, coordinates
from lagjax.system.checks import (
    SYSTEMS,
    by_name,
    check_system,
    check_use,
    checked,
    depends_on,
    prepare,
    traced_call,
    traced_system,
    with_rates,
)
from lagjax.system.constraints import (
    CompliantContact,
    Contact,
    Elements,
    Friction,
    Held,
    Holonomic,
    Nonholonomic,
    SampledControl,
    Stop,
)
from lagjax.system.coordinates import PrecisionWarning, State, is_traced
from lagjax.system.model import (
    FirstOrder,
    Form,
    Given,
    InModes,
    Model,
    UnknownSystem,
    differences,
    given_in,
    known_system,
    middle_state,
    model_of,
    signature,
    unchecked,
)
from lagjax.system.system import Hybrid, Switch, System, check_functions, rate_of, replace_fields
from lagjax.system.traced import OF_POSITION, OF_STATE, WITH_MULTIPLIERS, Traced, takes_of
from lagjax.system.user_errors import Call, check_arguments, in_words, warn
