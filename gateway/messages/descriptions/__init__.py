"""What the parameters say about the items of components: labels, units, force plates, events."""
