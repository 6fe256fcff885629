"""The outputs: one contract for all, and a module or package for each."""
