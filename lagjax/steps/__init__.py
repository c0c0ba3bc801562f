"""Steps of fixed length, one or many."""

from lagjax.steps.rollout import rollout
from lagjax.steps.step import step
