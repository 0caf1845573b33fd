"""Threads, processes and pace."""
