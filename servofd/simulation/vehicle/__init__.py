"""A simulated vehicle on a live MAVLink link: what it sends at a time is computed here, sockets are at the edge."""
