"""Steps of fixed length, one or many."""

from lagjax.steps.rollout import check_names, check_read, rollout
from lagjax.steps.step import step
