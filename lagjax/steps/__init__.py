"""Steps of fixed length, one or many."""

from lagjax.steps.rollout import check_names, check_read, merge_by_name, rollout
from lagjax.steps.step import step
