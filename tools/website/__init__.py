"""The documentation site: pages, examples and a reference of all public names, made by Sphinx."""
