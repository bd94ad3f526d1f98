"""The operator's view: circular sliders round the picture and the carved object, in a browser.

`store.ViewStore` holds what can be seen, whoever feeds it: `source.open_path` (a results folder or a bag) or
node `viewer` (the live graph). `server.ViewerServer` hands it to the page, which lies built in ``static/``.
"""
