"""Many flights audited: kept in tables, shown on one page."""
