"""What lagjax does with JAX's programs, whatever they compute: jaxprs as data, compiling, caches."""
