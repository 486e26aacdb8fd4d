"""Aircraft whose servos report nothing: what their motion tells of each axis."""
