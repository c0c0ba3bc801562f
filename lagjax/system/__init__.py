"""What the user writes, how it is checked, and the prepared model of it."""
