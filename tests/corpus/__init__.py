"""Plans that are known to be right or wrong, decided outside of prove(), which is judged by them."""
