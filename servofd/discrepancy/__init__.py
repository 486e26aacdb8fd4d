"""Where a servo and its model disagree, which effect is missing, and how the gap shrinks once it is added."""
