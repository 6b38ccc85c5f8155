"""The human step's study: run, drawings and page."""
