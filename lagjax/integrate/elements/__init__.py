"""Contacts and friction as elements: their modes, and what happens where contacts meet."""
