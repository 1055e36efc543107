"""Files: studies, measured shots and tables as they are written, without JAX."""
