"""What is bolted where: surfaces, outputs, calibrations, and what was recorded of them."""
