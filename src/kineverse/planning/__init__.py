"""Motion planning for any model (layer 5); needs a C compiler."""
