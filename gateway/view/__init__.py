"""A live 3D view in the browser; viser is imported only in this package."""
