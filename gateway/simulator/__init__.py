"""A complete RT server: the commands of §5, the parameters of §6, scenes made up or played from C3D files."""
