"""Many logs: found, judged side by side, kept in tables, shown on one page."""
