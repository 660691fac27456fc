"""Models shared by processes: a server keeps them, clients edit and follow them (layer 6)."""
