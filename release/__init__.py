"""Programs that build, describe and check a release. docs/dev/releasing.md says how to make one."""
