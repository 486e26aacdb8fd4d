"""The model bank: one hypothesis for each way in which a servo fails, and the decision between them."""
