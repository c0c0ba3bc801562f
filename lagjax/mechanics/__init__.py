"""The equations of motion at one state."""
