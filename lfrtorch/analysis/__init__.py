"""What a fitted model is: its poles, and how loud its inputs may be."""
