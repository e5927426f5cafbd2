"""Other ways to make a feature table, for comparison."""
