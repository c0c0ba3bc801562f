"""What the data say, and do not."""
