"""Names for what the robot measured, as its sensor will see them."""
