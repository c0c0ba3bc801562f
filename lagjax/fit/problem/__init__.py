"""The task of a fit."""
