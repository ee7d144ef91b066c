"""The settings of a session: a TOML file and the flags, checked."""
