// The page's beginning.
console.log("gsmap");
