"""The page server's side of the live page; it runs in a process of its own and never in the session's."""
