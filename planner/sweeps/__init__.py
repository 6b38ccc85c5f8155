"""Many plans at once: stored plans are proved again and compared."""
