"""Small dense, banded and rank-deficient linear algebra."""
