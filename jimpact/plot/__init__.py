"""Pictures: one function for each kind of result."""
