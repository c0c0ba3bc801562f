"""One-step methods in diffrax's interface."""
