"""Remote questions about a source, answered from caches."""
