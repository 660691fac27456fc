"""Tables of figures in the documentation: each is made by a command, and checked by a short form of it."""
