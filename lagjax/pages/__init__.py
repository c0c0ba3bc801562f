"""Pages that need neither Python nor a network: their scripts and their look, which lie beside this file."""

from lagjax.pages.page import Page, encoded, fragment, whole

__all__ = ["Page", "encoded", "fragment", "whole"]
