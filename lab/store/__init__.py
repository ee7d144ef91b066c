"""A session's folder on disk: how it is laid out, written, read and sealed."""
