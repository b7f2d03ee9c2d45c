"""The model, and the answers that it gives."""
