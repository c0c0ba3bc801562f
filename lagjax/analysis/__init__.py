"""What a system is like: its symmetries, equilibria and branches, small motions, cycles, and other forms of it."""
