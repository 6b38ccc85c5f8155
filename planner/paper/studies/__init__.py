"""Studies that compare parts of the paper with our results, and the page that they make together."""
