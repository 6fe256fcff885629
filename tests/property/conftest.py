from hypothesis import settings

# No time limit per example, because its duration depends on the load of the machine.
settings.register_profile("gateway", deadline=None)
settings.load_profile("gateway")
