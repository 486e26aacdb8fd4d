"""The verbs as functions for a notebook: results that show themselves, and become a table, a figure or a page."""
