"""Conversion of models to robot descriptions, shared by the writers of file formats."""
