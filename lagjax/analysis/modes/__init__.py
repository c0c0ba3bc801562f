"""Small motions."""
