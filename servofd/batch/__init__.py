"""Many logs: found, distinguished by their content, and spread over processes or machines."""
