"""The configuration: settings, their values, loading from YAML and the environment, showing, schema.

``settings`` has the whole configuration as frozen objects, made of sections (``section``) and values
(``values``); each output has its own section in its package.

``loading`` makes settings of files, and shows them: the effective configuration with the origin of each
value, and the JSON schema for editors. ``document`` has the values with their positions, those of variables
over those of the file, so every mistake is reported with the line or the variable that it is in, all at once.
``words`` has what these messages need, and hides passwords. ``files`` reads only what is a file.

To add a setting, add a field with a type from ``values`` and a docstring, and describe it in
docs/reference/configuration.md.
"""
