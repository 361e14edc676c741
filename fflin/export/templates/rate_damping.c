    /* b x omega / |b|^2, which is zero without a field */
    const ${name}_real square = y[0] * y[0] + y[1] * y[1] + y[2] * y[2];
    const ${name}_real divisor = square > $smallest ? square : $smallest;
    vector[0] = (y[1] * y[5] - y[2] * y[4]) / divisor;
    vector[1] = (y[2] * y[3] - y[0] * y[5]) / divisor;
    vector[2] = (y[0] * y[4] - y[1] * y[3]) / divisor;
