"""The hybrid map in the formats of other programs, and back."""
