"""What rests on undocumented behaviour of JAX and XLA, and on modules of JAX's that promise no stability.

- `plain.py`: the way out, `LAGJAX_PLAIN=1`, and when it is taken without being asked for.
- `marks.py`: the two attributes by which XLA compiles a program as one machine function; what each version needs.
- `compiling.py`: how XLA is asked to compile the programs that we call.
- `trial.py`: whether marked programs survive and are right with an XLA that is not known.
- `one_function.py`: a program as one machine function.
- `programs.py`: JAX programs (jaxprs) as data. `names.py`: the primitives that they are made of, by name.
- `primitives.py`: primitives of our own. `tracing.py`: whether JAX is tracing, and what it keeps of that.

No other package imports such modules, which `tests/test_architecture.py` asserts.
"""
