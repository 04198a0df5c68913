"""Control points marked in a browser: predicted places, marks, their files, and the page that shows them."""
