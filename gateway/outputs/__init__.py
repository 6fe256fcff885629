"""Where messages go: one contract (``contract.Output``), one module per kind of output."""
