"""Figures, films, progress."""
