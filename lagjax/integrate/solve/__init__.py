"""From a start to outputs and a result."""
