"""The ways to make one map of light and sound, each by its name."""
