"""A virtual BOLT behind a virtual radio: the real bleak client talks to it."""
