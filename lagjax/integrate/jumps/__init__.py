"""Forces that jump."""
