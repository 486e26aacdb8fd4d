"""Logs and an aircraft become series, and each verb does its work on them."""
