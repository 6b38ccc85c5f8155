"""report.html: one page per plan that needs no other file."""
