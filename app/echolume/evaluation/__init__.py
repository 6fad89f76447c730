"""How good a map is: scores of heights and labels, metrology on what the truth has, and whether its sigmas hold."""
