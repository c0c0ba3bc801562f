"""The analysis of a system: symmetries, equilibria, branches, small motions, cycles, other forms of its equations."""
