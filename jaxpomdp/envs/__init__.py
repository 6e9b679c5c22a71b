"""Worlds: tables, generators, files, Gymnasium both ways, pictures."""
