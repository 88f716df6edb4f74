"""Files and where they lie: written whole or not at all, here or in a bucket, and stand-ins for those elsewhere."""
