"""What a system is like. Each part is imported by its own name, as few programs need two."""
