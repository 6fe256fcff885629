"""The outputs: one contract, one module or package each."""
