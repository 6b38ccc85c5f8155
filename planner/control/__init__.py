"""The loop: a controller that plans again and again, MuJoCo with errors around it, and the verdict of both."""
