"""Pages that need neither Python nor a network; their scripts and style sheet are in this folder."""

from lagjax.display.web_page.page import Page, encoded, fragment, whole

__all__ = ["Page", "encoded", "fragment", "whole"]
