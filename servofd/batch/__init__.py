"""Many logs: found, told apart by their content, and spread over processes or machines."""
