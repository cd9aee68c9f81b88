"""How a map begins: by the parallax of corners, by a rig, or by ranges that are known."""
