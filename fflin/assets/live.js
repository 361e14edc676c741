function makeLive() { return {}; }
