static void MAP_map(const NAME_observer *observer, real *x_hat)
{
    real a[WIDTH], b[WIDTH];
    for (int i = 0; i < MODES; i++) {
        double mode = 0.0;
        for (int j = 0; j < COORDINATES; j++)
            mode += MAP_whiten[i][j] * (observer->z[j] - MAP_z_offset[j]);
        a[i] = (real)mode;
    }
/* LEVELS */
// if age
    a[AGE] = (real)log1p((observer->age * DT < END ? observer->age * DT : END) / UNIT);
// end age
    /* LAYERS */
    for (int i = 0; i < NX; i++)
        x_hat[i] = (real)(MAP_x_offset[i] + MAP_x_scale[i] * OUT[i]);
}

