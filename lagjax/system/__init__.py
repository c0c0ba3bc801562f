"""What the user writes, how it is checked, and the prepared model of it."""

from lagjax.system import constraints, coordinates
from lagjax.system.argument_checks import SYSTEMS, by_name, check_system
from lagjax.system.check_functions import checked, prepare, traced_call, traced_system
from lagjax.system.constraints import Holonomic, Nonholonomic
from lagjax.system.coordinates import PrecisionWarning, State, is_traced
from lagjax.system.elements import CompliantContact, Contact, Elements, Friction, Held, SampledControl, Stop
from lagjax.system.function_arguments import OF_POSITION, OF_STATE, WITH_MULTIPLIERS, takes_of
from lagjax.system.hybrid import Hybrid, Switch, replace_fields
from lagjax.system.model import FirstOrder, Form, Given, InModes, Model, given_in, model_of, unchecked
from lagjax.system.signature import UnknownSystem, differences, known_system, middle_state, signature
from lagjax.system.states import check_use, depends_on, with_rates
from lagjax.system.system import System, check_functions, rate_of
from lagjax.system.traced_functions import Traced
from lagjax.system.user_errors import Call, check_arguments, in_words
from lagjax.system.warn import warn
