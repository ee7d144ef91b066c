"""The devices of a session, real or virtual, and the world that the virtual ones share."""
