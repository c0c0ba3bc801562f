"""Everything that relies on undocumented behaviour of JAX and XLA, or on JAX modules that promise no stability.

- `plain.py`: the fallback to plain JAX programs, `LAGJAX_PLAIN=1`, and when it is taken automatically.
- `marks.py`: the two attributes by which XLA compiles a program as one machine function; what each version needs.
- `compiling.py`: how XLA is asked to compile the programs that we call.
- `one_function.py`: a program as one machine function.
- `one_by_one.py`: on a CPU no batch of LAPACK calls, which can stop a process for good.
- `programs.py`: JAX programs (jaxprs) as data. `names.py`: the primitives that they are made of, by name.
- `primitives.py`: primitives of our own. `tracing.py`: whether JAX is tracing, and the traces that it keeps.

No other package imports such modules, which `tests/test_architecture.py` asserts.
"""
