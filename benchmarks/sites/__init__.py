"""Benchmarks with two sites: a router in each, a link between them, and up to hundreds of subscribers."""
