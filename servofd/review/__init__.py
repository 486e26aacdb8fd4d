"""Recordings without their logs: checked, judged anew, cut, compared."""
