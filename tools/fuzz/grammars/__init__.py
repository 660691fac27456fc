"""Inputs by grammar, right and wrong: a module for each format."""
