"""The configuration: settings, their values, loading from YAML and the environment, showing, schema.

``settings`` has the whole configuration as frozen objects, made of sections (``section``) and values
(``values``); each output has its own section in its package. ``transform`` is the section about axes and
units.

``loading`` makes settings of files: ``yaml_document`` keeps the position of each value, ``environment`` puts
variables over the file, and every mistake is reported with the line or the variable that it is in, all at
once. ``words`` has what these messages need, and ``secrets`` hides passwords.

``show`` is for people: the effective configuration with the origin of each value, and the JSON schema for
editors. To add a setting, add a field with a type from ``values`` and a docstring, and describe it in
docs/reference/configuration.md.
"""
