"""The configuration: settings, their values, loading from YAML and the environment, showing, schema."""
