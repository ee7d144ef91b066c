"""The live page of a session: what people ask of it and what it shows while it rolls."""
