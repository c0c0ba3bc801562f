"""What a system is like."""
