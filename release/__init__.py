"""Programs that build, describe and check a release. CONTRIBUTING.md says how to make one."""
