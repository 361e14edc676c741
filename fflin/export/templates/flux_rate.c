    for (j = 0; j < 3; j++) {
        vector[j] = y[j];
    }
