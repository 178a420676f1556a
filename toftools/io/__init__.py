"""Files in and out: captures, foreign recordings, answers, camera intrinsics."""
