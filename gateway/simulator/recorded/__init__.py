"""A take as a scene: recorded components are served as they are, at the times at which they were captured."""
