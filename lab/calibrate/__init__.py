"""What a lab measures of itself before a session: camera, projector, robot."""
