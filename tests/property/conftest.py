from hypothesis import settings

# No time limit per example: how long one takes depends on what else the machine does.
settings.register_profile("gateway", deadline=None)
settings.load_profile("gateway")
