"""Jumps and kinks of forces, read off their programs."""
