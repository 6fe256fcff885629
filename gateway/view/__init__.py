"""The live 3D view in a browser."""
