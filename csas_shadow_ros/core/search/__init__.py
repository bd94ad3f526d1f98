"""The search: where the target and other bodies are, and whether the spectrum's sign fits the shadows."""
